"""What others publish for many robots, on their own hardware: never beside a time of ours without saying so."""

from typing import NamedTuple


class Published(NamedTuple):
    """One published result.

    Attributes:
        system: and what it is.
        solved, scenes: how many of how many scenes.
        seconds: mean time a scene; systems differ in whether failures count.
        hardware: on which it was measured.
    """

    system: str
    solved: int
    scenes: int
    seconds: float
    hardware: str


AKULE = "Akule (diffusion, XECBS search)"
MMD = "MMD (diffusion a robot, XECBS search)"
MPD = "MPD (diffusion, XECBS search)"
SMD = "SMD (projected diffusion, one joint model)"
DGD = "DGD (diffusion)"
GPU = "one large GPU"


def _run(system: str, solved: int, scenes: int, seconds: float) -> Published:
    return Published(system, solved, scenes, seconds, GPU)


PUBLISHED: dict[tuple[str, int], list[Published]] = {
    ("weave", 10): [_run(AKULE, 512, 512, 3.1), _run(MMD, 512, 512, 12.2), _run(MPD, 512, 512, 4.0)],
    ("weave", 20): [_run(AKULE, 256, 256, 7.1), _run(MMD, 256, 256, 33.4), _run(MPD, 256, 256, 26.7)],
    ("weave", 28): [_run(AKULE, 512, 512, 29.9), _run(MMD, 512, 512, 82.9), _run(MPD, 512, 512, 77.6)],
    ("scaled_weave", 40): [_run(AKULE, 10, 10, 32)],
    ("scaled_weave", 64): [_run(AKULE, 10, 10, 39)],
    ("scaled_weave", 256): [_run(AKULE, 8, 10, 143)],
    ("highways", 20): [_run(AKULE, 10, 10, 15.4), _run(MMD, 10, 10, 22.4)],
    ("conveyor", 20): [_run(AKULE, 6, 10, 38.2), _run(MMD, 6, 10, 43.0)],
    ("basic", 18): [_run(AKULE, 25, 25, 12), _run(DGD, 24, 25, 66)],
    ("dense", 18): [_run(AKULE, 25, 25, 37), _run(DGD, 19, 25, 48)],
    ("shelf", 18): [_run(AKULE, 22, 25, 77), _run(DGD, 21, 25, 325)],
    ("room", 18): [_run(AKULE, 24, 25, 66), _run(DGD, 25, 25, 219)],
    ("basic", 9): [_run(SMD, 25, 25, 504)],
    ("dense", 9): [_run(SMD, 25, 25, 582)],
    ("shelf", 9): [_run(SMD, 24, 25, 608)],
    ("room", 9): [_run(SMD, 24, 25, 239)],
}
"""By task and number of robots, as Akule's authors report it; all but SMD's run by them.

Their checks are more lenient than ours: pairs of robots at sampled steps alone (MMD), 5 mm of overlap (SMD).
"""

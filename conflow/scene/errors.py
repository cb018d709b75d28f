"""What demonstrations cannot be. Without torch, to be quick."""


class DemonstrationError(ValueError):
    """Demonstrations that cannot be used, with the reason in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(" ".join(reason.split()))

"""From recordings of people or robots to demonstrations: tracks, and windows in which some of them meet."""

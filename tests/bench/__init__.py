"""`make bench`: how fast this program is, beside what a user would take instead, measured in one run."""

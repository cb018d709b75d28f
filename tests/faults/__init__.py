"""Faults that are really caused: processes killed, disks filled, files broken, bad input given."""

"""Tests of ConFlow."""

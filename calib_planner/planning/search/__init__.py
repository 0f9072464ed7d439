"""Searching plans: one algorithm a file."""

"""Reads photographs and cameras from the folders that training uses."""

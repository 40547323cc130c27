"""Photographs and cameras, read from the folders that trainings use."""

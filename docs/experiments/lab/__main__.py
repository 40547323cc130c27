"""Runs an experiment from a checkout: ``cd docs/experiments; python -m lab NAME ...``."""

from lab.command import command

if __name__ == "__main__":
    command(prog_name="python -m lab")

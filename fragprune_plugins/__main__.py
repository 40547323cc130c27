"""``python -m fragprune_plugins``: the command line, where its script is not on the path."""

from fragprune_plugins.workbench.commands import main

if __name__ == "__main__":
    main()

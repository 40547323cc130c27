"""The workbench: whatever a person starts from the command line, one folder for each command.

The core (everything beside this folder but ``testing``) never imports it, and a host that runs
under ``fragprune run`` loads none of it.
"""

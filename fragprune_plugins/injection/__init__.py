"""Injects thresholds into a running host: docs/explanation/architecture.md lists the modules."""

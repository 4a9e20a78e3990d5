"""The package's version, the only place that states it (setup.py reads it; a test compares package.xml)."""

__version__ = "0.1.0"

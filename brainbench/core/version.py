"""The version of the package, stated once: the wheel, records and provenance read it here."""

__version__ = "0.2.0"

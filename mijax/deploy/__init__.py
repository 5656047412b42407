"""Exported policies: what writes them, what checks them, and what runs them without the library."""

"""Cutting the changed objects out of the reported regions."""

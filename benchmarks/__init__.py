"""Measurements as tables, never part of the tests."""

"""Tests: the reference, one file a module, then the laws."""

"""Figures of speed, memory and accuracy, each from one command: ``python -m benchmarks NAME``."""

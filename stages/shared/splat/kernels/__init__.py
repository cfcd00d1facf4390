"""Compiled pieces of the CPU backend; `cpu.py` calls them in order."""

"""Scores of a rendered picture against the true one; every function has a named oracle in its test."""

"""What this machine is, what works on it, and what will be slow."""

"""Triangle meshes: files, checks, ray casting, clean-up."""

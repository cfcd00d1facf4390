"""Small foreign inputs with their expected answers, kept outside the repository."""

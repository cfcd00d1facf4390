"""How the error of every public numerical function grows with the size of its input."""

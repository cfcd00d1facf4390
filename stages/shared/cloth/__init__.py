"""Cloth simulation: extended position-based dynamics of garments on a moving body.

`material` and `constraints` describe a garment, `surface` what it touches, `kernels` advance it by a frame,
`reference` does the same slowly in plain NumPy, `simulator` runs several garments over a motion.
"""

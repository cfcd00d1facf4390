"""Outfits: a body and garments as layers that are posed, worn by another body, and rendered together."""

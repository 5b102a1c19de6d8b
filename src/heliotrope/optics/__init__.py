"""Light: beams, their images and flux, keep-out volumes, glare."""

"""The renderer of camera images: rays, surfaces, light, and what is in the air."""

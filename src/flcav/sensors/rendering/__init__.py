"""Renderer of camera images: deferred shading of a G-buffer, with shadows, ambient occlusion, weather and glare.

Colours are linear RGB unless a name says otherwise.
"""

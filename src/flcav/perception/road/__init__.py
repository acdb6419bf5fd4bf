"""Semantic road perception: a class of marking for every pixel of a camera picture, and lane lines as polylines."""

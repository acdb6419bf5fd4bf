"""Commands of `flcav odd`, about operational design domains and drives within them."""

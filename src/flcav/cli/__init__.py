"""Command line of flcav: commands parse their arguments, call the library, and print."""

"""The comparison of corner cases: whether knowledge of rare kinds of objects travels between regions."""

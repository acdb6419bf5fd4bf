"""Consistency checks of a dataset; each yields one sentence per problem."""

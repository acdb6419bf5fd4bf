"""Checks of a dataset, one sentence per problem."""

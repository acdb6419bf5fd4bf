"""The image repository of the provider and the director repository of the customer (TUF, Uptane)."""

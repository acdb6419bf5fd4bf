"""The provider's image repository and the customer's director repository (TUF, Uptane)."""

"""Commands about operational design domains, and about drives in them."""

"""Messages of a federation: their records, their encoding, what is asked, what is accepted, and what arrives."""

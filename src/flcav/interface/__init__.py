"""What users meet: public names and their documentation, wording of messages, progress, optional extras."""

"""The inner optimisers and what they move."""

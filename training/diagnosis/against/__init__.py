"""What differs between new recordings and healthy ones."""

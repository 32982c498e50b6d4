"""What a cable is made of, found from how it moved."""

"""What a contact sensor is worth, and how much of that observed motion gives without one."""

"""Videos of moving bodies compared with renders of the model: image loss and pose tracking."""

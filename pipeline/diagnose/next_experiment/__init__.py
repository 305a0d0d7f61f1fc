"""What to measure next: throws and motions, and the information that they would give."""

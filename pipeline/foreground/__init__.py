"""What photos show of a body and what is behind it, told apart by colours and edges."""

"""Which parts of photos and scenes are bodies, where no masks say so."""

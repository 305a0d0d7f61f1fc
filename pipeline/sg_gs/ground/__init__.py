"""The ground in photos: its picture from above, cast shadows, and how it looks without the bodies."""

"""Stage phys-geo: fit the contact model to measured tracks or to videos, with effects where they are named."""

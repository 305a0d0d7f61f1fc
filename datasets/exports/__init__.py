"""Writers of other people's formats: one module each. No torch at import."""

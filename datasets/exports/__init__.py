"""Writers of the formats of other tools: one module per format. torch is not imported."""

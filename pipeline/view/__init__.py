"""Looking at motion: where everything is at a moment, how contacts are drawn, and a viewer in the browser."""

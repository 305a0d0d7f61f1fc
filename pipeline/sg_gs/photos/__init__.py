"""Photos as the fit reads them: views, their overlap, exposure and corrected camera poses."""

"""Building blocks of HTML reports: pages, tables and charts."""

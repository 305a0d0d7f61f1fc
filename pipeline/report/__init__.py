"""Pieces of reports: the page, its charts and pictures, the verdict, and estimates next to the truth."""

"""The rivals themselves: their own code, which is run from where it was fetched to and of which nothing is kept here.

What stands here turns a capture of the benchmark into what they read, and their predictions into what `scoring.py`
judges. Where the code lies is said by environment variables, see `source.py`; docs/rivals.md has the commands.
"""

"""`fic-sweep bench`: what this machine does, beside others' ways to do the same.

Kept empty: a timed process imports this package before its clock may be disturbed.
"""

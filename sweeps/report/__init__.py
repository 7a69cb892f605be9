"""`fic-sweep report`: what the paper claims, measured; what was found beyond it."""

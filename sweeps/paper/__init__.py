"""`fic-sweep report`: the paper's claims, measured, judged and written down."""

"""Controllers by kind, and the gate that withholds a lost estimate from them."""

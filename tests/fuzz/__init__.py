"""Mutated inputs for every reader: what is wrong is refused by a `UserError`, and by nothing else.

Each kind of file has a module that says what sound files look like, how they are spoiled, and who
reads them. Input `number` of a kind is always the same one, so that a find can be made again.
"""

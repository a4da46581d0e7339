"""Read-outs: what features of tactile encoders tell linearly of the object, before a policy is trained on them.

``features`` lets a policy act once and makes features of what it felt; ``probe`` reads the object from them on
environments left out and compares features, or placements of taxels. An optional room with its own command.
"""

"""Read-outs: what features of tactile encoders tell linearly of the object, before a policy is trained on them.

``rollout`` lets a policy act once; ``arms`` makes features of what it felt; ``regression`` reads the object from them
on environments left out; ``probe`` does all of it.
"""

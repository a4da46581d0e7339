"""Policies of robot hands: a brain-scored network as tactile front end, teachers, students, exported files.

``encoders`` turn taxels into features, ``student`` is the rsl_rl model class that has one, ``training`` teaches it,
``evaluate`` runs whole episodes, ``export`` writes a file with its ``contract``. ``readouts`` is an optional room.
"""

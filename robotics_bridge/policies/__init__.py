"""Policies of robot hands: a brain-scored network as tactile front end, teachers, students, deployment.

``taxel_grid`` lays a hand's taxels on the input of an encoder, ``front_end`` runs the encoder on it, ``encoders`` names
all arms of the comparison, ``student`` is the rsl_rl model class, ``distill`` teaches it, ``deploy`` runs it on a hand.
"""

"""The robotics bridge: brain-scored encoders as the tactile front end of robot hands.

This version holds no code yet; the tactile simulator and the policies come with later versions. The
package exists so that its name and its import rules (models and the floor, never the reverse) stand.
"""

"""Optional: convex decomposition by CoACD or V-HACD, for whiskers on concave objects. Nothing else imports this folder.

``cutting`` runs ``worker`` in a process of its own with limits, keeps the pieces in the cache and measures how far
they are from the mesh. Without the folder collision = "decomposition" says that it is missing.
"""

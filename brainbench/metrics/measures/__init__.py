"""The metrics: RSA, CKA, ridge, decoding, Procrustes, partial RSA, and their registry."""

"""Operations that networks are built of, and their fused GPU paths behind one dispatch."""

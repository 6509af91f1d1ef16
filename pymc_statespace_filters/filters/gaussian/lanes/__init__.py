"""A deterministic filter on several records side by side, one SIMD lane each."""

"""What all filters that move members by noise share."""

"""Which parameter varies, and when: tests of constancy from the scores of the terms."""

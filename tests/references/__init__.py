"""Truths to measure the package against, written without any of its code.

Each file is one independent answer: a point-mass filter (``grid``), an extended Kalman filter as a
PyTensor scan (``scan_oracle``), ensemble and particle filters in plain NumPy with faults to switch
on (``faulty_filters``), and the seeded records that they are compared on (``records``).
"""

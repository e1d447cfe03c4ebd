"""What tests and benchmarks share to drive vical itself: feeds, boards, recordings, junk, a test machine.

The only part of the mocks that imports `vical_daemon`.
"""

"""MicroStrain inertial sensors: single-byte and MIP protocols, port, device."""

"""The Cramer-Rao bound of a simulated recording, from its truth alone."""

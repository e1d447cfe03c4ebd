"""From nothing to a running filter: a closed-form start, then rehearsals that learn the noise."""

"""What every process of the service needs: clock, paths, health, systemd."""

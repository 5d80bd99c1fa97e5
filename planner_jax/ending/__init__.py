"""What a quadrotor flies after its last contact: to rest where it may, or back home."""

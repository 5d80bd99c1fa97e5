"""The hit sweep: serves, columns, table and figures of quadrotor volleys."""

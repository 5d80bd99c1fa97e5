"""The sweeps of interceptions and of groups: settings, columns, table and figures."""

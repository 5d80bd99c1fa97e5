"""The block sweep: settings, columns and figures of an arm that blocks balls."""

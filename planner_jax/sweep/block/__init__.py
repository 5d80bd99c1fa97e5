"""The sweep of blocks: plan and judge many cases of an arm that blocks a ball with a shield."""

"""The subcommands of `spinndrift`: one dataclass each, its fields the options, `run()` the work."""

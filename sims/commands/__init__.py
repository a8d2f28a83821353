"""The subcommands of `spinndrift`: a dataclass each, with the options as fields and `run()`."""

"""One run of a scenario: closed loop, log, metrics, folder."""

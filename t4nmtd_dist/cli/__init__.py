"""The ``t4nmtd`` command and its subcommands."""

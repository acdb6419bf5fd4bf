"""The commands of `flcav release`: candidates, the parties' repositories and vehicles, roll-outs."""

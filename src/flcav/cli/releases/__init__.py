"""Commands of `flcav release`: candidates, repositories of both parties, vehicles, roll-outs."""

"""Radio links of vehicles to roadside units: line of sight, path loss, link budget, rate."""

"""Radio links of vehicles to roadside units: line of sight, loss, link budget, rate."""

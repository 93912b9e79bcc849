"""Which dampers, where: mass, clearance and place that make the worst peak smallest; knows no sensor, no recording."""

"""What scripts find: devices as data sheets describe them, their names, what they measure, sensors' data sheets."""

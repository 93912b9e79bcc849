"""The bench: plant, measuring chain and converter on one clock; drive in, samples at one or several rates out."""

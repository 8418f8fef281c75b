"""Systems of the papers and those they compare with: short functions on core and cuts."""

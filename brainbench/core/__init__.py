"""What every package stands on: errors, files, records, data contracts, statistics, rotations and devices."""

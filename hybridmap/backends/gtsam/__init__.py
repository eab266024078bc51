"""Back-ends on GTSAM: batch, incremental, robust, calibrating. Imports here are absolute: `gtsam` is the library."""

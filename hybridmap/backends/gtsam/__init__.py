"""Back-ends on GTSAM: batch, incremental, robust, calibrating. Absolute imports only: `gtsam` is the library."""

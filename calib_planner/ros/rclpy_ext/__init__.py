"""What works around rclpy: each file says what rclpy does, why that does not serve us, and when it may go."""

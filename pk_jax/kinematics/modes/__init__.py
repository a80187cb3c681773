"""All poses that fit the joints: found by homotopy or in closed form, counted, and the ways between them."""

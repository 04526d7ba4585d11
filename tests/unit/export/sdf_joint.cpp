// Loads an SDF file with Gazebo's own library and prints what it understood of its joint: a name and a number a line.
#include <iostream>
#include <sdf/sdf.hh>

int main(int, char **argv) {
  sdf::Root root;
  const sdf::Errors errors = root.Load(argv[1]);
  for (const auto &error : errors) std::cerr << error.Message() << "\n";
  if (!errors.empty() || root.Model() == nullptr) return 1;
  const sdf::Joint &joint = *root.Model()->JointByIndex(0);
  const sdf::JointAxis &axis = *joint.Axis(0);
  const auto body = root.Model()->LinkByIndex(0)->Inertial().MassMatrix();
  std::cout.precision(17);
  std::cout << "prismatic " << (joint.Type() == sdf::JointType::PRISMATIC) << "\ndamping " << axis.Damping()
            << "\nfriction " << axis.Friction() << "\neffort " << axis.Effort() << "\nvelocity "
            << axis.MaxVelocity() << "\nmass " << body.Mass() << "\ninertia " << body.Izz() << "\n";
}

package Modelica "What the export uses of the Modelica Standard Library 4, by its interfaces; dry friction is smooth"
  package Units
    package SI
      type Angle = Real(unit = "rad");
      type AngularVelocity = Real(unit = "rad/s");
      type Current = Real(unit = "A");
    end SI;
  end Units;
  package Blocks
    package Interfaces
      connector RealInput = input Real;
    end Interfaces;
  end Blocks;
  package Electrical
    package Analog
      package Interfaces
        connector PositivePin
          Real v;
          flow Real i;
        end PositivePin;
        connector NegativePin
          Real v;
          flow Real i;
        end NegativePin;
      end Interfaces;
    end Analog;
  end Electrical;
  package Mechanics
    package Rotational
      package Interfaces
        connector Flange_a
          Real phi;
          flow Real tau;
        end Flange_a;
        connector Flange_b
          Real phi;
          flow Real tau;
        end Flange_b;
      end Interfaces;
      package Components
        model Inertia
          parameter Real J;
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
          Real phi(start = 0, fixed = true);
          Real w(start = 0, fixed = true);
        equation
          phi = flange_a.phi;
          phi = flange_b.phi;
          w = der(phi);
          J * der(w) = flange_a.tau + flange_b.tau;
        end Inertia;
        function interpolate
          input Real table[:, 2];
          input Real at;
          output Real y;
        algorithm
          y := table[size(table, 1), 2];
          for k in 1:size(table, 1) - 1 loop
            if at >= table[k, 1] and at < table[k + 1, 1] then
              y := table[k, 2] + (table[k + 1, 2] - table[k, 2]) * (at - table[k, 1]) / (table[k + 1, 1] - table[k, 1]);
            end if;
          end for;
        end interpolate;
        model BearingFriction
          parameter Boolean useSupport = false;
          parameter Real tau_pos[:, 2] = [0, 1];
          parameter Real peak = 1;
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
          Real w;
          Real tau;
        equation
          flange_a.phi = flange_b.phi;
          w = der(flange_a.phi);
          tau = peak * interpolate(tau_pos, abs(w)) * tanh(w / 0.01);
          flange_a.tau + flange_b.tau = tau;
        end BearingFriction;
        model IdealGear
          parameter Boolean useSupport = false;
          parameter Real ratio;
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
        equation
          flange_a.phi = ratio * flange_b.phi;
          0 = ratio * flange_a.tau + flange_b.tau;
        end IdealGear;
      end Components;
      package Sources
        model Torque
          parameter Boolean useSupport = false;
          Interfaces.Flange_b flange;
          Modelica.Blocks.Interfaces.RealInput tau;
        equation
          flange.tau = -tau;
        end Torque;
      end Sources;
    end Rotational;
  end Mechanics;
end Modelica;
